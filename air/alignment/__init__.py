"""Where each photo was taken: features, matching, bundle adjustment."""
