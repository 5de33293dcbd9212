"""From candidate submaps to poses with likelihoods and covariances."""
