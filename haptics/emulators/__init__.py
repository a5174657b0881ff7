"""Emulators: programs that speak a device's protocol on a real socket or pseudo-terminal, backed by virtual devices."""
