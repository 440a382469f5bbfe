"""What is handed over: tables, figures and one self-contained page."""
