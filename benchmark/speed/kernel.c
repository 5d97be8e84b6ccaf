/* A hand-written projection: the floor that the engines are measured against.
 *
 * lens: fx, fy, cx, cy, k1..k4 of h = f (theta + k1 theta^3 + ...), s0, e0, e1, e2 of Gennery's
 * viewpoint shift.  The ray equation is solved by Newton steps in t = tan(theta / 2), as in the
 * package; no steps: a single viewpoint.  No domain checks, no points on the axis.
 */
#include <math.h>

#define INLINE static inline __attribute__((always_inline))

enum { BLOCK = 256, NEWTON_STEPS = 3 };

typedef struct {
    double ex, ey, r, theta, sine, cosine, clearance;
} Ray;

INLINE void gennery(const double *s, double theta, double t, double *value, double *slope)
{
    const double z = theta * theta, cosecant = (1 + t * t) / (2 * t), ratio = theta * cosecant;
    const double growth_slope = cosecant - ratio * (1 - t * t) / (2 * t);
    const double factor = s[1] + z * (s[2] + z * s[3]);
    *value = s[0] + (ratio - 1) * factor;
    *slope = growth_slope * factor + (ratio - 1) * theta * (2 * s[2] + 4 * s[3] * z);
}

INLINE Ray meet(const double *shift, int steps, double x, double y, double z)
{
    const double r = sqrt(x * x + y * y), distance = sqrt(r * r + z * z), inverse = 1 / r;
    double t = z >= 0 ? r / (distance + z) : (distance - z) * inverse;
    double value = 0, slope = 0;
#pragma GCC unroll 3
    for (int i = 0; i < steps; i++) {
        gennery(shift, 2 * atan(t), t, &value, &slope);
        const double reach = z - value;
        t += (r * (1 - t * t) - 2 * reach * t)
             / (2 * r * t + 2 * reach - 4 * t * slope / (1 + t * t));
    }
    const double theta = 2 * atan(t), scale = 1 / (1 + t * t);
    if (steps)
        gennery(shift, theta, t, &value, &slope);
    const double sine = 2 * t * scale, cosine = (1 - t * t) * scale;
    const double clearance = r * sine + (z - value) * cosine - slope * sine;
    return (Ray){x * inverse, y * inverse, r, theta, sine, cosine, clearance};
}

INLINE double height(const double *k, double theta)
{
    const double z = theta * theta;
    return theta * (1 + z * (k[0] + z * (k[1] + z * (k[2] + z * k[3]))));
}

INLINE double height_slope(const double *k, double theta)
{
    const double z = theta * theta;
    return 1 + z * (3 * k[0] + z * (5 * k[1] + z * (7 * k[2] + z * 9 * k[3])));
}

INLINE void project(long n, const double *points, const double *lens, int steps, double *uv)
{
    for (long start = 0; start < n; start += BLOCK) {
        const int count = (int)(n - start < BLOCK ? n - start : BLOCK);
        const double *p = points + 3 * start;
        double *out = uv + 2 * start, u[BLOCK], v[BLOCK];
#pragma omp simd
        for (int i = 0; i < count; i++) {
            const Ray ray = meet(lens + 8, steps, p[3 * i], p[3 * i + 1], p[3 * i + 2]);
            const double h = height(lens + 4, ray.theta);
            u[i] = lens[2] + lens[0] * h * ray.ex;
            v[i] = lens[3] + lens[1] * h * ray.ey;
        }
        for (int i = 0; i < count; i++) {
            out[2 * i] = u[i];
            out[2 * i + 1] = v[i];
        }
    }
}

/* A row d of the derivatives by the point in the camera -> those by place and turn of the camera */
INLINE void for_pose(const double *R, double a, double b, double c, double d0, double d1,
                     double d2, double (*out)[BLOCK], int i)
{
    const double x = d0 * R[0] + d1 * R[1] + d2 * R[2];
    const double y = d0 * R[3] + d1 * R[4] + d2 * R[5];
    const double z = d0 * R[6] + d1 * R[7] + d2 * R[8];
    out[0][i] = -x;
    out[1][i] = -y;
    out[2][i] = -z;
    out[3][i] = y * c - z * b;
    out[4][i] = z * a - x * c;
    out[5][i] = x * b - y * a;
}

INLINE void linearise(long n, const double *points, const double *rotation,
                      const double *position, const double *lens, int steps, double *uv,
                      double *jacobian)
{
    const double *R = rotation;
    double part[14][BLOCK];
    for (long start = 0; start < n; start += BLOCK) {
        const int count = (int)(n - start < BLOCK ? n - start : BLOCK);
#pragma omp simd
        for (int i = 0; i < count; i++) {
            const double *p = points + 3 * (start + i);
            const double a = p[0] - position[0], b = p[1] - position[1], c = p[2] - position[2];
            const Ray ray = meet(lens + 8, steps, R[0] * a + R[3] * b + R[6] * c,
                                 R[1] * a + R[4] * b + R[7] * c, R[2] * a + R[5] * b + R[8] * c);
            const double h = height(lens + 4, ray.theta), ex = ray.ex, ey = ray.ey;
            const double slope = height_slope(lens + 4, ray.theta) / ray.clearance;
            const double across = h / ray.r, along = slope * ray.cosine, axial = -slope * ray.sine;
            const double mixed = (along - across) * ex * ey;
            const double fx = lens[0], fy = lens[1];
            part[0][i] = lens[2] + fx * h * ex;
            part[1][i] = lens[3] + fy * h * ey;
            for_pose(R, a, b, c, fx * (along * ex * ex + across * ey * ey), fx * mixed,
                     fx * axial * ex, part + 2, i);
            for_pose(R, a, b, c, fy * mixed, fy * (along * ey * ey + across * ex * ex),
                     fy * axial * ey, part + 8, i);
        }
        for (int i = 0; i < count; i++) {
            for (int k = 0; k < 2; k++)
                uv[2 * (start + i) + k] = part[k][i];
            for (int k = 0; k < 12; k++)
                jacobian[12 * (start + i) + k] = part[2 + k][i];
        }
    }
}

/* points (n, 3) in the camera frame -> uv (n, 2) */
void project_shift(long n, const double *points, const double *lens, double *uv)
{
    project(n, points, lens, NEWTON_STEPS, uv);
}

void project_svp(long n, const double *points, const double *lens, double *uv)
{
    project(n, points, lens, 0, uv);
}

/* points (n, 3) in the world, rotation (3, 3) and position (3) of the camera there
 * -> uv (n, 2) and its derivatives (n, 2, 6) by place and turn in the world frame */
void linearise_shift(long n, const double *points, const double *rotation, const double *position,
                     const double *lens, double *uv, double *jacobian)
{
    linearise(n, points, rotation, position, lens, NEWTON_STEPS, uv, jacobian);
}

void linearise_svp(long n, const double *points, const double *rotation, const double *position,
                   const double *lens, double *uv, double *jacobian)
{
    linearise(n, points, rotation, position, lens, 0, uv, jacobian);
}
