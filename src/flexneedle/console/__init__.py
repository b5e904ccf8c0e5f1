"""What commands share: arguments, progress, tables and JSON on stdout."""
