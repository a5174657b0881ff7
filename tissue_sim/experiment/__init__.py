"""Experiments: specimen, tool, interfaces, protocol and contact laws."""
