// Differential equations along sampled signals, one step after the other: what numpy cannot do for all samples at once.
//
// Arguments are contiguous buffers of doubles, of which `rrr_oc.numerics` makes arrays, and numbers. Results are written into the
// last buffer.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <cmath>
#include <vector>

namespace {

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

PyMethodDef methods[] = {
  {"across_gap", py_across_gap, METH_VARARGS,
   "across_gap(count, load, stiffness, mass, steps, half, damping, parts, result): see `rrr_oc.numerics.gap`."},
  {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {PyModuleDef_HEAD_INIT, "_stepping", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__stepping() { return PyModule_Create(&module); }
