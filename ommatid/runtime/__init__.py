"""Files, processes, memory and errors: the parts of the program that know nothing of cameras."""
