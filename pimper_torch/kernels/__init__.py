"""Compiled twins of a few hot functions, for the CPU.

Each stands in for a torch module or function, which stays the reference, what the kernel is tested
against, and the path for gradients and for other devices: see
:func:`~pimper_torch.kernels.switch.compiled_for`. A kernel runs on one thread and lets other
threads run; :mod:`~pimper_torch.parallel` runs several side by side.
"""
