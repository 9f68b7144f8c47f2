def headline(*a): return ""
def report(*a): pass
