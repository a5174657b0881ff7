"""Parts that several commands use: argument types, experiment flags, exit codes, consoles, tables and progress."""
