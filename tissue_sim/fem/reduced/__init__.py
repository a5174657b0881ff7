"""A solid in a few hundred of its motions and elements: the solver `reduced`."""
