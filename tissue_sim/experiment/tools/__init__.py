"""Rigid tools that are moved into the specimen."""
