"""Files, processes, memory and failures: what runs beneath the program, without knowledge of cameras."""
