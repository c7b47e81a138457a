"""The figures and claims of Wood, Rajan and Christensen, reproduced."""
