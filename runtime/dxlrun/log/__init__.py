"""Log: topics and messages, the recorder's process, the writer, the reader.

The interpretation of a log belongs in `dxlrun_analysis`.
"""
