"""Sums of vectors with weights, in blocks that LLVM keeps in registers."""

from twoloop.kernels.data.common import compiled

BLOCK = 8  # numbers: the length of vectors is a multiple of it


@compiled
def weighted_sum(weights, slopes, total):
    """The sum of weights[k] slopes[k], block by block, each in registers."""
    for m in range(0, total.size, BLOCK):
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0
        for k in range(weights.size):
            weight = weights[k]
            s0 += weight * slopes[k, m]
            s1 += weight * slopes[k, m + 1]
            s2 += weight * slopes[k, m + 2]
            s3 += weight * slopes[k, m + 3]
            s4 += weight * slopes[k, m + 4]
            s5 += weight * slopes[k, m + 5]
            s6 += weight * slopes[k, m + 6]
            s7 += weight * slopes[k, m + 7]
        total[m] = s0
        total[m + 1] = s1
        total[m + 2] = s2
        total[m + 3] = s3
        total[m + 4] = s4
        total[m + 5] = s5
        total[m + 6] = s6
        total[m + 7] = s7
