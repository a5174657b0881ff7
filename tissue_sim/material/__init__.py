"""Materials: law, parameters, bulk response, and effects of time, loading history and depth."""
