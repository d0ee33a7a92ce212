"""The orthophoto: which photo each cell shows, and its colours."""
