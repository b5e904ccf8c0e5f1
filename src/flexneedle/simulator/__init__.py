"""The finite element simulator: (X, C)_{k+1} = f((X, C)_k, U_k) (paper eq. 1)."""
