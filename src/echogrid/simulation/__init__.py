"""Sound and rooms: worlds, drives through them, and what sonars hear there."""
