"""Messages of devices: bytes to values and back, without a connection. Clients and emulators share these modules."""
