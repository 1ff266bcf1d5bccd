"""Models from the literature: one reading after the other, or the whole log at once."""
