"""The rig: what stands between the tissue and the numbers."""
