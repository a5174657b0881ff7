"""What devices say on their lines: bytes to values and back, without any line. Clients and emulators share it."""
