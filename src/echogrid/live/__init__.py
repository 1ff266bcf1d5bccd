"""What a robot that drives now needs: its messages over DDS in, maps out."""
