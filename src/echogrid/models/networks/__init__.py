"""The networks: the set network for any array, and the paper's, each with its local map."""
