"""The paper reproduced, certified and corrected: its tables and figures beside ours.

The command is `run.reproduce`; each other module is one part of what it puts on the page.
"""
