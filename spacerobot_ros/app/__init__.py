"""Command line, scenario runner and reports; composes the nodes in one process."""
