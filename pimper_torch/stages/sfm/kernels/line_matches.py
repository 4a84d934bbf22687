"""The best matches near each feature's epipolar line."""

import numpy as np
import numpy.typing as npt

from pimper_torch.kernels.compile import compiled

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@compiled(
    "void(float64[:,::1], float64[:,::1], float32[:,::1], float32[:,::1], float64[:,::1], boolean,"
    " float64, float32[:,::1], float32[:,::1], int64[::1], int64[::1])",
    fast=True,
)
def most_alike(
    first: Doubles,
    second: Doubles,
    first_descriptors: Floats,
    second_descriptors: Floats,
    matrix: Doubles,
    planar: bool,
    max_error_px: float,
    first_products: Floats,
    second_products: Floats,
    first_best: Indices,
    second_best: Indices,
) -> None:
    """Compute, for every feature, the two largest descriptor products near its epipolar line.

    Args:
        first: Pixels in the first photograph.
        matrix: Homography from the first photograph, or fundamental matrix.
        max_error_px: Distance from the mapped point, or Sampson distance from the epipolar line.
        first_products: Result, -1 before: the largest and the second largest product.
        second_products: The same for features of the second photograph.
        first_best: Result, -1 before: index of the feature with the largest product.
    """
    count, length = len(second), second_descriptors.shape[1]
    x, y = np.empty(count, np.float32), np.empty(count, np.float32)
    slope, candidates = np.zeros(count, np.float32), np.empty(count, np.int64)
    # Relative to the centroid, float32 resolves a hundredth of a pixel.
    centre_x, centre_y = second[:, 0].mean(), second[:, 1].mean()
    for j in range(count):
        u, v = second[j, 0], second[j, 1]
        x[j], y[j] = u - centre_x, v - centre_y
        if not planar:
            back_u = u * matrix[0, 0] + v * matrix[1, 0] + matrix[2, 0]
            back_v = u * matrix[0, 1] + v * matrix[1, 1] + matrix[2, 1]
            slope[j] = max_error_px**2 * (back_u**2 + back_v**2)
    limit = np.float32(max_error_px**2)
    for i in range(len(first)):
        u, v = first[i, 0], first[i, 1]
        a = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]
        b = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]
        c = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        num_candidates = 0
        if planar:
            mapped_x, mapped_y = np.float32(a / c - centre_x), np.float32(b / c - centre_y)
            for j in range(count):
                candidates[num_candidates] = j
                num_candidates += (x[j] - mapped_x) ** 2 + (y[j] - mapped_y) ** 2 <= limit
        else:
            line_x, line_y = np.float32(a), np.float32(b)
            offset = np.float32(a * centre_x + b * centre_y + c)
            bound = np.float32(max_error_px**2 * (a * a + b * b))
            for j in range(count):
                candidates[num_candidates] = j
                num_candidates += (x[j] * line_x + y[j] * line_y + offset) ** 2 <= bound + slope[j]
        descriptor = first_descriptors[i]
        for index in range(num_candidates):
            j = candidates[index]
            other_descriptor = second_descriptors[j]
            product = np.float32(0)
            for k in range(length):
                product += descriptor[k] * other_descriptor[k]
            if product > first_products[i, 0]:
                first_products[i, 1] = first_products[i, 0]
                first_products[i, 0] = product
                first_best[i] = j
            elif product > first_products[i, 1]:
                first_products[i, 1] = product
            if product > second_products[j, 0]:
                second_products[j, 1] = second_products[j, 0]
                second_products[j, 0] = product
                second_best[j] = i
            elif product > second_products[j, 1]:
                second_products[j, 1] = product
