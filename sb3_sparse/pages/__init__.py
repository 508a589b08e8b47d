"""Self-contained HTML pages, and tables for pages and CSV files."""
