"""What becomes of a map and its drive: files, pictures, pages."""
