"""Report: tables, figures and self-contained pages of the results."""
