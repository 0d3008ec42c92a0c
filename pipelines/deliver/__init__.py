"""What a surveyor takes away: one module a deliverable."""
