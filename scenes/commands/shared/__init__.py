"""What several commands share: arguments, flags of an experiment, consoles, tables, pictures."""
