"""From recordings and a forward model to parameters with uncertainties."""
