"""What people read: tables, pictures, pages, files."""
