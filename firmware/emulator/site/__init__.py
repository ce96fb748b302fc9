"""A site in virtual time: medium, chips, boards behind pseudo-terminals, and the programs of their hosts."""
