"""What is asked: campaign files, and the recordings that they name."""
