"""Where a matrix was ever seen to have an entry: a pattern is 1 there, else 0."""

from twoloop.kernels.data.common import compiled, merged


@merged
def has_new_entries(G, pattern):
    """Whether an entry of G is not zero for the first time."""
    entries, seen = G.reshape(G.size), pattern.reshape(pattern.size)
    unseen = 0.0  # a sum without a branch: there is nothing new at nearly every look
    for i in range(seen.size):
        unseen += abs(entries[i]) * (1.0 - seen[i])
    return unseen != 0.0  # also true for NaN


@compiled
def note_pattern(G, pattern):
    """Note the entries of G that are not zero; whether there are new ones."""
    if not has_new_entries(G, pattern):
        return False
    new = False
    for i in range(pattern.shape[0]):
        for j in range(pattern.shape[1]):
            if G[i, j] != 0.0 and pattern[i, j] == 0.0:
                pattern[i, j] = 1.0
                new = True
    return new
