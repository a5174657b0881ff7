"""Parameter estimation: least-squares fits of material laws to recordings, uncertainties and rankings."""
