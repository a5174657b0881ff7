"""Real-time simulations: pose of the tool in, force on the tool with status and stated error out."""
