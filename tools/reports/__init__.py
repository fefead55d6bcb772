"""What people look at: figures computed from recordings and truth, tables, pictures, HTML."""
