"""Benchmark of engines: the force on a tool in soft tissue, the same five jobs in every engine."""
