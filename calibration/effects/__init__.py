"""Effects of tissue, contact, specimen and rig that a basic model omits; one module per effect."""
