from torchdof.tensors import TRACEABLE

# all of these tests write a file first
collect_ignore_glob = [] if TRACEABLE else ["test_*.py"]
