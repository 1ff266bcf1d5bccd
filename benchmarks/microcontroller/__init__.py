"""What an export takes of a microcontroller, and what its map is worth."""
