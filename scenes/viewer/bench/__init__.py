"""A page that watches a bench: a recorder that runs, or a sensor and a stage. It moves nothing."""
