"""The experiments of the paper that the project starts from, redone beside its published numbers; a module a figure."""
