"""Compiled hot functions, for the CPU.

Functions that need gradients or other devices exist twice: in torch, which is the reference, and as
a kernel, see :func:`~pimper_torch.kernels.switch.compiled_for`. Non-differentiable functions
(structure from motion, the coarse surface, hierarchies of multigrid, decimation) have only a
kernel. Each runs on one thread without the GIL; :mod:`~pimper_torch.runtime.parallel` runs several.
"""
