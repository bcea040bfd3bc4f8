// A casadi::Function of scalar operations, evaluated at many instants at once.
//
// casadi's own virtual machine decodes every operation anew for every instant. Here an operation is decoded once for WIDTH
// instants, which the compiler then does side by side.
//
// program(text) -> a program, from `casadi.Function.serialize()`
// run(program, arguments, results, count, threads): arguments are (buffer, common) in order, where a common one is the same at
//     all instants; results are buffers. Buffers hold doubles, instant by instant, each instant dense and column-major.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <casadi/core/function.hpp>

#include <algorithm>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define FOR_THIS_MACHINE __attribute__((target_clones("avx2", "default")))
#else
#define FOR_THIS_MACHINE
#endif

namespace {

constexpr int WIDTH = 32;
using Index = casadi_int;
using Math = casadi::casadi_math<double>;

struct Operation
{
  int code;
  Index out, one, other;  // places in the work vector; of OP_INPUT and OP_OUTPUT: number of the array and element
  double constant;
};

struct Program
{
  std::vector<Operation> operations;
  std::vector<Index> argument_sizes, result_sizes;  // elements of an instant
  Index work;
};

struct Argument
{
  const double * data;
  bool common;
};

Program make_program(const std::string & text)
{
  const casadi::Function f = casadi::Function::deserialize(text);
  if (!f.is_a("SXFunction")) throw std::runtime_error(f.name() + ": a Function of scalar operations is needed");
  Program p{{}, {}, {}, 0};
  std::vector<std::vector<Index>> inputs, outputs;  // places of the nonzeros in the dense array
  for (Index i = 0; i < f.n_in(); ++i) inputs.push_back(f.sparsity_in(i).find()), p.argument_sizes.push_back(f.numel_in(i));
  for (Index i = 0; i < f.n_out(); ++i) outputs.push_back(f.sparsity_out(i).find()), p.result_sizes.push_back(f.numel_out(i));
  for (Index k = 0; k < f.n_instructions(); ++k)
  {
    Operation o{static_cast<int>(f.instruction_id(k)), 0, 0, 0, 0.0};
    const std::vector<Index> from = f.instruction_input(k), to = f.instruction_output(k);
    if (o.code == casadi::OP_CONST) o.out = to.at(0), o.constant = f.instruction_constant(k);
    else if (o.code == casadi::OP_INPUT) o.out = to.at(0), o.one = from.at(0), o.other = inputs.at(o.one).at(from.at(1));
    else if (o.code == casadi::OP_OUTPUT) o.out = to.at(0), o.other = outputs.at(o.out).at(to.at(1)), o.one = from.at(0);
    else if (o.code != casadi::OP_CALL && (from.size() == 1 || from.size() == 2))
      o.out = to.at(0), o.one = from[0], o.other = from.back();
    else throw std::runtime_error(f.name() + ": operation " + std::to_string(o.code) + " is not one of scalars");
    if (o.code != casadi::OP_OUTPUT) p.work = std::max(p.work, o.out + 1);
    p.operations.push_back(o);
  }
  return p;
}

template<typename F>
inline void each(double * out, const double * one, const double * other, F f)
{
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC ivdep
#endif
  for (int i = 0; i < WIDTH; ++i) out[i] = f(one[i], other[i]);  // `out` may be an operand, never beside one
}

// Instants `first` … `first + used − 1`; the rest of the block repeats the last one.
FOR_THIS_MACHINE void block(
  const Program & p, const std::vector<Argument> & arguments, const std::vector<double *> & results, Index first, int used, double * w)
{
  for (const Operation & o : p.operations)
  {
    double * const out = w + o.out * WIDTH;
    const double * const one = w + o.one * WIDTH;
    const double * const other = w + o.other * WIDTH;
    switch (o.code)
    {
    case casadi::OP_CONST: std::fill(out, out + WIDTH, o.constant); break;
    case casadi::OP_INPUT:
    {
      const Argument & a = arguments[o.one];
      const Index size = p.argument_sizes[o.one];
      if (a.common || !a.data) std::fill(out, out + WIDTH, a.data ? a.data[o.other] : 0.0);
      else for (int i = 0; i < WIDTH; ++i) out[i] = a.data[(first + std::min(i, used - 1)) * size + o.other];
      break;
    }
    case casadi::OP_OUTPUT:
      for (int i = 0; i < used; ++i) results[o.out][(first + i) * p.result_sizes[o.out] + o.other] = one[i];
      break;
    case casadi::OP_ADD: each(out, one, other, [](double x, double y) { return x + y; }); break;
    case casadi::OP_SUB: each(out, one, other, [](double x, double y) { return x - y; }); break;
    case casadi::OP_MUL: each(out, one, other, [](double x, double y) { return x * y; }); break;
    case casadi::OP_DIV: each(out, one, other, [](double x, double y) { return x / y; }); break;
    case casadi::OP_NEG: each(out, one, one, [](double x, double) { return -x; }); break;
    case casadi::OP_SQ: each(out, one, one, [](double x, double) { return x * x; }); break;
    case casadi::OP_TWICE: each(out, one, one, [](double x, double) { return 2 * x; }); break;
    default: Math::fun(static_cast<unsigned char>(o.code), one, other, out, WIDTH);
    }
  }
}

void run(
  const Program & p, const std::vector<Argument> & arguments, const std::vector<double *> & results, Index begin, Index end)
{
  std::vector<double> w(p.work * WIDTH);
  for (Index k = begin; k < end; k += WIDTH)
    block(p, arguments, results, k, static_cast<int>(std::min<Index>(WIDTH, end - k)), w.data());
}

void destroy(PyObject * capsule) { delete static_cast<Program *>(PyCapsule_GetPointer(capsule, "program")); }

PyObject * py_program(PyObject *, PyObject * object)
{
  Py_ssize_t size;
  const char * text = PyUnicode_AsUTF8AndSize(object, &size);
  if (!text) return nullptr;
  try
  {
    return PyCapsule_New(new Program(make_program(std::string(text, size))), "program", destroy);
  }
  catch (const std::exception & error)
  {
    return PyErr_Format(PyExc_ValueError, "%s", error.what());
  }
}

// Buffers held while a call lasts.
struct Held
{
  std::vector<Py_buffer> views;
  ~Held() { for (Py_buffer & v : views) PyBuffer_Release(&v); }
  double * get(PyObject * object, bool writable, Index elements)
  {
    Py_buffer view;
    if (PyObject_GetBuffer(object, &view, PyBUF_ANY_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0))) return nullptr;
    views.push_back(view);
    if (view.len == elements * static_cast<Py_ssize_t>(sizeof(double))) return static_cast<double *>(view.buf);
    PyErr_Format(PyExc_ValueError, "expected %lld numbers, got a buffer of %zd bytes", static_cast<long long>(elements), view.len);
    return nullptr;
  }
};

PyObject * py_run(PyObject *, PyObject * args)
{
  PyObject *capsule, *argument_list, *result_list;
  long long count;
  int threads;
  if (!PyArg_ParseTuple(args, "OO!O!Li", &capsule, &PyList_Type, &argument_list, &PyList_Type, &result_list, &count, &threads))
    return nullptr;
  const Program * p = static_cast<Program *>(PyCapsule_GetPointer(capsule, "program"));
  if (!p) return nullptr;
  const Py_ssize_t n_in = p->argument_sizes.size(), n_out = p->result_sizes.size();
  if (PyList_Size(argument_list) != n_in || PyList_Size(result_list) != n_out)
    return PyErr_Format(PyExc_ValueError, "expected %zd arguments and %zd results, got %zd and %zd", n_in, n_out,
                        PyList_Size(argument_list), PyList_Size(result_list));
  Held held;
  std::vector<Argument> arguments(n_in);
  std::vector<double *> results(n_out);
  for (Py_ssize_t i = 0; i < n_in; ++i)
  {
    PyObject * buffer;
    int common;
    if (!PyArg_ParseTuple(PyList_GetItem(argument_list, i), "Op", &buffer, &common)) return nullptr;
    arguments[i] = {held.get(buffer, false, p->argument_sizes[i] * (common ? 1 : count)), common != 0};
    if (PyErr_Occurred()) return nullptr;
  }
  for (Py_ssize_t i = 0; i < n_out; ++i)
  {
    results[i] = held.get(PyList_GetItem(result_list, i), true, p->result_sizes[i] * count);
    if (PyErr_Occurred()) return nullptr;
    std::fill(results[i], results[i] + p->result_sizes[i] * count, 0.0);
  }
  Py_BEGIN_ALLOW_THREADS;
  std::vector<std::thread> others;
  for (int k = 1; k < threads; ++k)
    others.emplace_back(run, std::cref(*p), std::cref(arguments), std::cref(results), count * k / threads, count * (k + 1) / threads);
  run(*p, arguments, results, 0, count / std::max(threads, 1));
  for (std::thread & other : others) other.join();
  Py_END_ALLOW_THREADS;
  Py_RETURN_NONE;
}

PyMethodDef methods[] = {
  {"program", py_program, METH_O, "program(text): a program made of a serialized casadi.Function of scalar operations."},
  {"run", py_run, METH_VARARGS, "run(program, [(argument, common), ...], [result, ...], count, threads): evaluate at instants."},
  {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {PyModuleDef_HEAD_INIT, "_along", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__along() { return PyModule_Create(&module); }
