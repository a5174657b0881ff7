"""Rigid tools: what is moved into the specimen."""
