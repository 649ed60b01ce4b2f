"""The quantization study: sets through codes and widths, into tables."""
