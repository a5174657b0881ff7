"""Contact of tissue with rigid bodies: functions that the kernels of all solvers share."""
