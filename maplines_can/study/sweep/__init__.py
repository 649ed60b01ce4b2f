"""The study of covariance codes: sets of Gaussians through codes and widths, into tables."""
