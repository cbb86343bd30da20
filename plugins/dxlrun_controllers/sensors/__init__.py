"""The standard sensors, offered as any package offers some."""
