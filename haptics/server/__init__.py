"""Serve a simulated tissue to other programs: poses and forces over UDP, configuration over TCP."""
