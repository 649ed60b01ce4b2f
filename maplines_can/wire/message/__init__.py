"""DBC to layout, records to bytes, and back."""
