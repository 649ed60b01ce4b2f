"""The messages of a DBC: signals, records, what they must have."""
