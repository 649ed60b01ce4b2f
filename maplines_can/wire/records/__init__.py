"""Records: lines and pose errors to payloads and back."""
