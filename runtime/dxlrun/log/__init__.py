"""The log: topics and messages, the writer and its process, the reader."""
