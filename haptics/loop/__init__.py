"""The 1 kHz loop, in a process of its own."""
