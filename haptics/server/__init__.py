"""The tissue for other programs."""
