"""A solid's bulk, frozen and condensed onto the nodes near a tool, and the contact that is solved on it."""
