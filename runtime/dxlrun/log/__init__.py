"""Log: topics and messages, the recorder's process, the writer, the reader.

What a log means belongs in `dxlrun_analysis`.
"""
