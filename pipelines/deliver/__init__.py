"""Deliverables of a survey, one module each."""
