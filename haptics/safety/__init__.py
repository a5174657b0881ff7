"""What is between the tissue's force and the hand."""
