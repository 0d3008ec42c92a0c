"""The types that every stage speaks in, and their files: survey, marks, scene, adjustment, model, report."""
