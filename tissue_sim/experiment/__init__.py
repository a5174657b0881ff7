"""An experiment: specimen, tool, interfaces, protocol."""
