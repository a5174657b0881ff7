"""Statistics of fits: noise and jitter of recordings, score tests, covariances, prediction bands and populations."""
