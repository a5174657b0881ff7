"""Tests whose force is a formula: homogeneous ones, columns that weigh, histories."""
