"""What production lane messages lose by rounding."""
