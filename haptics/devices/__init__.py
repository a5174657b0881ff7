"""Where poses come from and forces go."""
