"""Campaign files: read a campaign, its specimens, tests, fit settings and recordings."""
