"""Pictures of what the others find, a module for each."""
