// mrcal's own CAHVORE core over many points; compiled with cahvore.cc of mrcal's sources.
extern "C" {
#include "basic-geometry.h"
#include "_cahvore.h"
}

// points (n, 3) with the pupil's offset s0 taken off; lens: f, cx, cy, e0, e1, e2 -> uv (n, 2)
// and, where asked for, the derivatives of the distorted point by the point (n, 3, 3)
extern "C" void mrcal_project(long n, const double* points, const double* lens, double* uv,
                              double* gradient)
{
    const double distortion[8] = {0, 0, 0, 0, 0, lens[3], lens[4], lens[5]};
    for (long i = 0; i < n; i++) {
        mrcal_point3_t p{}, q{};
        for (int k = 0; k < 3; k++)
            p.xyz[k] = points[3 * i + k];
        project_cahvore_internals(&q, nullptr, gradient ? gradient + 9 * i : nullptr, &p,
                                  distortion, 0.0);
        uv[2 * i] = lens[1] + lens[0] * q.x / q.z;
        uv[2 * i + 1] = lens[2] + lens[0] * q.y / q.z;
    }
}
