"""Where simulation and measurement disagree, which effect is missing, and what would tell more."""
