"""What a rig and a tissue do that a plain model does not: a file an effect."""
