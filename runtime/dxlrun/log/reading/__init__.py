"""What lies between the bytes of a log and its reader: files, chunks, slices of a run, columns of topics."""
