"""Results for people to read: HTML reports, figures, tables and text files."""
