"""Force of a test as a differentiable function of parameters, for NumPy, JAX and PyTorch."""
