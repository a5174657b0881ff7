"""From the files of a test machine to a campaign: what they hold, what is a replicate, what only a person knows."""
