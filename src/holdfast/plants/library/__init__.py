"""Ready plants, one module each: a function ``build`` that returns a checked plant."""
