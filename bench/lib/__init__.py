"""What several programs share: inputs, timing, fits, results, tables, pages, command lines."""
