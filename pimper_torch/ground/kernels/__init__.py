"""Compiled hot functions, for the CPU.

Where gradients or other devices may be asked for, a kernel stands in for a torch function, which
stays the reference: see :func:`~pimper_torch.ground.kernels.switch.compiled_for`. What is constant
to autograd (structure from motion, the coarse surface, hierarchies of multigrid, decimation) has
the kernel alone. A kernel runs on one thread and lets other threads run;
:mod:`~pimper_torch.runtime.parallel` runs several side by side.
"""
