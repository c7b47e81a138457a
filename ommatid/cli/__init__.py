"""The command line: options are parsed, functions are called, results are printed."""
