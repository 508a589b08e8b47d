"""HTML pages that need nothing but themselves, and tables for pages and CSV files."""
