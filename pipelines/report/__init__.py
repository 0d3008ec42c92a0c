"""The report of a survey, and what every page and picture is made with: frame, plots, PDF."""
