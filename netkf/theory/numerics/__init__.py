"""Functions of plain matrices: checked inputs, algebraic equations, gaps and moves."""
