"""The paper: its law as a controller, its plant, and the study of its tables and figures."""
