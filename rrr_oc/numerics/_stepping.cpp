// Differential equations along sampled signals, one step after the other: what numpy cannot do for all samples at once.
//
// Arguments are contiguous buffers of doubles, of which `rrr_oc.numerics` makes arrays, and numbers. Results are written into the
// last buffer.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

constexpr double CRITICAL = 1e-6;  // damping counts as critical if that share of the frequency is left of it; doubled, no change
constexpr double STEEPEST = 50.0;  // exponent by which a diverging state may grow in a substep; doubled, numbers become infinite

// Buffers held while a call lasts.
struct Held
{
  std::vector<Py_buffer> views;
  ~Held() { for (Py_buffer & v : views) PyBuffer_Release(&v); }
  double * get(PyObject * object, bool writable, Py_ssize_t elements)
  {
    Py_buffer view;
    if (PyObject_GetBuffer(object, &view, PyBUF_C_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0))) return nullptr;
    views.push_back(view);
    if (view.len == elements * static_cast<Py_ssize_t>(sizeof(double))) return static_cast<double *>(view.buf);
    PyErr_Format(PyExc_ValueError, "expected %zd numbers, got a buffer of %zd bytes", elements, view.len);
    return nullptr;
  }
};

struct Gap
{
  const double *load, *stiffness, *mass, *steps;
  double half, damping;
  int parts;
};

// x'' between the ends by semi-implicit Euler in `parts` of a step; position, speed and mean acceleration of each step to x, v, a.
void across_gap(const Gap & g, Py_ssize_t count, double * x, double * v, double * a)
{
  double position = g.load[0] > 0 ? -g.half : g.half, speed = 0.0;
  bool rests = true;
  for (Py_ssize_t k = 0; k < count; ++k)
  {
    const double slowing = g.damping / g.mass[k], part = g.steps[k] / g.parts, before = speed;
    if (rests) rests = position > 0 ? !(g.load[k] + g.stiffness[k] * g.half > 0) : !(g.load[k] - g.stiffness[k] * g.half < 0);
    x[k] = position, v[k] = speed;
    for (int i = 0; i < (rests ? 0 : g.parts); ++i)
    {
      speed = (speed - (g.load[k] + g.stiffness[k] * position) / g.mass[k] * part) / (1 + slowing * part);
      position += speed * part;
      if (std::abs(position) >= g.half) position = position > 0 ? g.half : -g.half, speed = 0.0;
    }
    a[k] = (speed - before) / g.steps[k];
    rests = rests || std::abs(position) == g.half;
  }
}

PyObject * py_across_gap(PyObject *, PyObject * args)
{
  PyObject *load, *stiffness, *mass, *steps, *result;
  Py_ssize_t count;
  Gap g;
  if (!PyArg_ParseTuple(args, "nOOOOddiO", &count, &load, &stiffness, &mass, &steps, &g.half, &g.damping, &g.parts, &result))
    return nullptr;
  Held held;
  if (!(g.load = held.get(load, false, count)) || !(g.stiffness = held.get(stiffness, false, count))) return nullptr;
  if (!(g.mass = held.get(mass, false, count)) || !(g.steps = held.get(steps, false, count))) return nullptr;
  double * const to = held.get(result, true, 3 * count);
  if (!to) return nullptr;
  Py_BEGIN_ALLOW_THREADS;
  if (count > 0) across_gap(g, count, to, to + count, to + 2 * count);
  Py_END_ALLOW_THREADS;
  Py_RETURN_NONE;
}

struct Oscillation
{
  const double *t, *mass, *total, *particular;  // particular: (4, K − 1), by powers of the time in each step
  double damping;
};

// The free oscillator over a step: its state at the end is [[even + decay odd, odd], [−square odd, even − decay odd]] (x, v).
void turned(double decay, double square, double h, double & even, double & odd)
{
  const double least = CRITICAL * std::sqrt(square), inside = decay * decay - square;
  const double root = std::max(std::sqrt(std::abs(inside)), least);
  if (inside < 0 && root > least)
  {
    const double size = std::exp(-decay * h);
    even = size * std::cos(root * h), odd = size * std::sin(root * h) / root;
    return;
  }
  const double slow = std::exp((root - decay) * h), lost = std::expm1(-2 * root * h);
  even = slow * (1 + lost / 2), odd = -slow * lost / (2 * root);
}

// Motions (m, 3, K) from initial states (m, 2): position, speed, acceleration.
void oscillate(const Oscillation & o, Py_ssize_t count, const double * starts, Py_ssize_t motions, double * result)
{
  const Py_ssize_t last = count - 1;
  for (Py_ssize_t i = 0; i < motions; ++i) result[3 * i * count] = starts[2 * i], result[(3 * i + 1) * count] = starts[2 * i + 1];
  for (Py_ssize_t k = 0; k < last; ++k)
  {
    const double h = o.t[k + 1] - o.t[k], decay = o.damping / o.mass[k] / 2, square = o.total[k] / o.mass[k];
    const double *p0 = o.particular + k, *p1 = p0 + last, *p2 = p1 + last, *p3 = p2 + last;
    const double position = ((*p3 * h + *p2) * h + *p1) * h + *p0, speed = (3 * *p3 * h + 2 * *p2) * h + *p1;
    double even, odd;
    turned(decay, square, h, even, odd);
    for (Py_ssize_t i = 0; i < motions; ++i)
    {
      double *x = result + 3 * i * count + k, *v = x + count, *a = v + count;
      const double off = *x - *p0, rate = *v - *p1;
      a[0] = 2 * *p2 - 2 * decay * rate - square * off;
      x[1] = position + (even + decay * odd) * off + odd * rate;
      v[1] = speed - square * odd * off + (even - decay * odd) * rate;
      if (k == last - 1) a[1] = 2 * *p2 + 6 * *p3 * h - 2 * decay * (v[1] - speed) - square * (x[1] - position);
    }
  }
}

PyObject * py_oscillate(PyObject *, PyObject * args)
{
  PyObject *t, *mass, *total, *particular, *starts, *result;
  Py_ssize_t count, motions;
  Oscillation o;
  if (!PyArg_ParseTuple(args, "nnOOOdOOO", &count, &motions, &t, &mass, &total, &o.damping, &particular, &starts, &result))
    return nullptr;
  Held held;
  if (!(o.t = held.get(t, false, count)) || !(o.mass = held.get(mass, false, count - 1))) return nullptr;
  if (!(o.total = held.get(total, false, count - 1))) return nullptr;
  if (!(o.particular = held.get(particular, false, 4 * (count - 1)))) return nullptr;
  const double * const from = held.get(starts, false, 2 * motions);
  double * const to = from ? held.get(result, true, 3 * motions * count) : nullptr;
  if (!to) return nullptr;
  Py_BEGIN_ALLOW_THREADS;
  oscillate(o, count, from, motions, to);
  Py_END_ALLOW_THREADS;
  Py_RETURN_NONE;
}

struct Relaxation
{
  const double *t, *constant, *slope;
  Py_ssize_t parts;
};

// x' = constant + slope x, where constant and slope are given at the ends of `parts` equal substeps of each interval between samples
// and taken as their means over a substep; x at the samples.
void relax(const Relaxation & r, Py_ssize_t count, double * x)
{
  const double *constant = r.constant, *slope = r.slope;
  for (Py_ssize_t k = 0; k + 1 < count; ++k)
  {
    const double h = (r.t[k + 1] - r.t[k]) / r.parts;
    double value = x[k];
    for (Py_ssize_t i = 0; i < r.parts; ++i, ++constant, ++slope)
    {
      const double more = (constant[0] + constant[1]) / 2 * h, grown = (slope[0] + slope[1]) / 2 * h;
      const double change = std::expm1(std::min(grown, STEEPEST));
      value += change * value + (std::abs(grown) > 1e-8 ? change / std::min(grown, STEEPEST) : 1.0) * more;
    }
    x[k + 1] = value;
  }
}

PyObject * py_relax(PyObject *, PyObject * args)
{
  PyObject *t, *constant, *slope, *result;
  Py_ssize_t count;
  double start;
  Relaxation r;
  if (!PyArg_ParseTuple(args, "nnOOOdO", &count, &r.parts, &t, &constant, &slope, &start, &result)) return nullptr;
  if (count < 1) return PyErr_Format(PyExc_ValueError, "expected a sample or more, got %zd", count);
  Held held;
  const Py_ssize_t fine = r.parts * (count - 1) + 1;
  if (!(r.t = held.get(t, false, count)) || !(r.constant = held.get(constant, false, fine))) return nullptr;
  if (!(r.slope = held.get(slope, false, fine))) return nullptr;
  double * const to = held.get(result, true, count);
  if (!to) return nullptr;
  to[0] = start;
  Py_BEGIN_ALLOW_THREADS;
  relax(r, count, to);
  Py_END_ALLOW_THREADS;
  Py_RETURN_NONE;
}

PyMethodDef methods[] = {
  {"across_gap", py_across_gap, METH_VARARGS,
   "across_gap(count, load, stiffness, mass, steps, half, damping, parts, result): see `rrr_oc.numerics.gap`."},
  {"oscillate", py_oscillate, METH_VARARGS,
   "oscillate(count, motions, t, mass, total, damping, particular, starts, result): see `rrr_oc.numerics.oscillator`."},
  {"relax", py_relax, METH_VARARGS, "relax(count, parts, t, constant, slope, start, result): see `rrr_oc.numerics.relaxation`."},
  {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {PyModuleDef_HEAD_INIT, "_stepping", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__stepping() { return PyModule_Create(&module); }
