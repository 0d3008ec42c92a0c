"""What every stage stands on: errors, types, options, products, the table of stages, workspace, runner."""
