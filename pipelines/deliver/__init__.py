"""Deliverables of a survey, one module for each."""
