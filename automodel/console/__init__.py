"""What commands share at a terminal: messages, tables, progress, keys, worker processes."""
