"""The report of a survey: everything that is known of it, as one page and as a PDF."""
