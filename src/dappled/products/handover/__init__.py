"""Write a flight as pictures and poses for the programs that make models of them."""
