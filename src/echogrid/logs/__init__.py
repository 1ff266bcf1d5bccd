"""Recorded logs in: one file a format, one table, and every format yields the same Frame."""
