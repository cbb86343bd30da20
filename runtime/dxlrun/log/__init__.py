"""Log: messages and topics of a log, its recorder process, its writer and its reader.

The interpretation of a log belongs in `dxlrun_analysis`.
"""
