"""The paper's law as a controller, its plants, and the study of its tables and figures."""
