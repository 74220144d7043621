"""Pictures to tag corners, target offsets and poses with covariance."""
