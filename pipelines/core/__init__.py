"""Foundation of every stage: errors, types, options, products, the table of stages, workspace, runner."""
