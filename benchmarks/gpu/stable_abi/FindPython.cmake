# In place of CMake's own, for gpu_libraries.py: no interpreter that fits is needed, only the headers of a Python from 3.12
# on, in SPLATPIPE_PYTHON_HEADERS. What is compiled with them and Py_LIMITED_API runs with every Python from 3.12 on.
add_executable(Python::Interpreter IMPORTED)
set_target_properties(Python::Interpreter PROPERTIES IMPORTED_LOCATION "${Python_EXECUTABLE}")
add_library(Python::Module INTERFACE IMPORTED)
target_include_directories(Python::Module INTERFACE "${SPLATPIPE_PYTHON_HEADERS}")
add_library(Python::SABIModule ALIAS Python::Module)
set(Python_INCLUDE_DIRS "${SPLATPIPE_PYTHON_HEADERS}")
set(Python_VERSION 3.12)
set(Python_INTERPRETER_ID Python)
set(Python_FOUND TRUE)
add_compile_definitions(Py_LIMITED_API=0x030C0000)
