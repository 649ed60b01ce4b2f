"""Records of map lines: their layout as a DBC describes it, and how to write and read them."""
